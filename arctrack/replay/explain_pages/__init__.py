"""The page that explains one frame: its words, pictures and plots."""
