"""All calibrations that a folder of raw files allows, and their certificate."""
