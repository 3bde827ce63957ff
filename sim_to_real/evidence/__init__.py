"""The evidence of hypotheses about a gap: error model, log evidence, posterior."""
