"""Where the gap lies: in which stage, and along which covariate."""
