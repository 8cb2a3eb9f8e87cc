"""What reaches outside: the PLC, the journal's disk."""
