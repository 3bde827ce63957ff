"""Policy of outliers among readings that should agree, for all calibrations."""

FALSE_ALARM = 0.01
"""The probability that readings which agree are taken not to, in a whole set."""

MAX_OUTLIER_SHARE = 0.3
"""The largest share that is left out one by one: beyond it nothing tells which are wrong."""

TAIL = 4.0
"""Degrees of freedom of Student's t in robust fits: a fifth of wrong points hardly moves them."""
