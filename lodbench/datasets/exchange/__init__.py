"""Posed images in the formats of other programs: reader and writer of a format together.

Metashape, Pix4D and ODM share their angles, and so ``photogrammetry``.
"""
