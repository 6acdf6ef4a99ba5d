"""What a flight some years before the demo's photos brought home: a textured map.

``town_then`` is the town as it was, ``baking`` lays its surfaces out on pictures and paints them in the light
of that day, ``textured_map`` writes the whole as GLB. ``demo`` keeps it in the cache.
"""
