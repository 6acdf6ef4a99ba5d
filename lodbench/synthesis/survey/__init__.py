"""What a flight some years before the demo's photos brought home, as a textured map; baked, then kept."""
