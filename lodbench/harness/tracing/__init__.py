"""Maps traced in posed photos: roof outlines in two or more, snapped to the edges of all, as LoD1 prisms."""
