"""Figures anyone can make again: accuracy on a real model, and speed beside other programs."""
