"""What flights say besides poses: in words, on a map, on a page."""
