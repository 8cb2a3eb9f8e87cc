"""Pure functions: no bus, clock, thread, file or log."""
