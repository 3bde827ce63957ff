"""The laser stripe: found, followed through the image and measured, with its sigma."""
