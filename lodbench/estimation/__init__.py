"""What all methods that align a map share: edges of a photo, lines of the model, and how the latter move."""
