"""A made-up town: its streets, buildings, relief and planting, written as CityGML."""
