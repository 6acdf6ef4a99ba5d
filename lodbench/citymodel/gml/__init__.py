"""CityGML 1.0, 2.0 and 3.0: read a city object at a time, and written a building at a time."""
