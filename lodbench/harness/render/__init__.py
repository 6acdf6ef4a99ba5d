"""Pictures of a city from given poses."""
