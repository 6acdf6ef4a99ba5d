"""One's own photos: localised one by one, checked, and made into datasets."""
