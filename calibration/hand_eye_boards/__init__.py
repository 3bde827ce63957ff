"""The camera's pose on a robot from images of a board: maximum likelihood, and how well it is known."""
