"""Clothes on a body that skin weights move: PBNS, virtual bones, and what they need."""
