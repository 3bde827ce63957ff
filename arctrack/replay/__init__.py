"""A recording through tracker and controller, and the pages that show it."""
