"""The page of a diagnosis: its words, pictures and advice."""
