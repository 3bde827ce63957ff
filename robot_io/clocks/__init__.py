"""Whose clock a time is by, how clocks differ, and how late a robot follows."""
