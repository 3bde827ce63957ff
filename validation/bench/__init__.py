"""A benchmark of methods that read a stripe or find a seam, theirs and ours."""
