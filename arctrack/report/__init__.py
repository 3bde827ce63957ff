"""Pictures and tables for people; matplotlib lives here alone."""
