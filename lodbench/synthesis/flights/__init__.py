"""Seeded flights over any city, along paths of ``camera_paths``; what drone and map are wrong about."""
