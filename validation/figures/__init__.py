"""The paper's figures and the pictures of the effects, and the reference that the model is held against."""
