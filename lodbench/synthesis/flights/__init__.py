"""Seeded flights over any city: where the photos were taken, what drone and map were wrong about.

How a flight goes over the place is in ``camera_paths``, what drone and map are wrong about in ``errors``;
both become ``dataset=flights`` in ``dataset``.
"""
