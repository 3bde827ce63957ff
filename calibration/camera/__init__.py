"""The camera's intrinsics from corners of boards: maximum likelihood, and how well each is known."""
