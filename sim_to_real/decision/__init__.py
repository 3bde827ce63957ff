"""Decision from fits, its checks on frames held out, and the next experiment."""
