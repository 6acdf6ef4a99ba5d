"""Training of networks: views read, changed at random, learnt from, and stored as a segmenter's weights."""
