"""From fits to an answer: the decision, its checks on frames held out, the next experiment."""
