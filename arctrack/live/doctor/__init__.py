"""Whether a machine can run a cell live, and how late its offsets would go out."""
