"""What a flight some years before the demo's photos brought home: a textured map.

``textured_map`` has the town as it was and writes it as GLB; ``baking`` lays its surfaces out on pictures and
paints them in the light of that day. ``demo`` keeps it in the cache.
"""
