"""Reconstructions placed in cities."""
