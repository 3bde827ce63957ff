"""References that judge the model: the hemisphere's sum in full, and the paper's figures."""
