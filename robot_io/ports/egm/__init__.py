"""ABB's Externally Guided Motion with path correction: protobuf over UDP."""
