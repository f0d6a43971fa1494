"""Where heads come from: synthetic, anny, your own files; remeshed and augmented.

Import the one you need, such as `skinlib.datasets.synthetic`: anny alone takes seconds.
"""
