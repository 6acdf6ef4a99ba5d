"""Posed images in the formats of other programs: one module per format, reader and writer together.

Metashape, Pix4D and ODM share their angles, and so ``photogrammetry``.
"""
