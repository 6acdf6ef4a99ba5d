"""Is a city sound: its polygons in their planes, its shells, its solids; and the report of all findings."""
