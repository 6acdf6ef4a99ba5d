"""Seeded flights over any city: where the photos were taken, what drone and map were wrong about.

=================================  ===========================================
how a flight goes over the place   a function of ``paths``, named in ``PATHS``
what a drone is wrong about        ``errors``
what a map is wrong about          ``map_changes``
the dataset                        ``dataset``
=================================  ===========================================
"""
