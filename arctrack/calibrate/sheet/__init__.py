"""The laser sheet from a scan of any flat plate."""
