"""The network and its training; everything that imports torch."""
