"""Finger geometry: the stock finger, cages, inverse design, export."""
