"""Datasets: folders, published layouts, priors, cards, and poses in the formats of other programs."""
