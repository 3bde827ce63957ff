"""Fits of nuisances and effects to a recording, by a model linearized at anchors."""
