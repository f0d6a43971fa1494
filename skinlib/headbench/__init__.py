"""HeadBench: the judge of skin weights."""
