"""What a flight says of the map, as outlines of buildings. Pages of flights: ``runs``, ``photo``."""
