"""Pure functions on arrays, numbers and messages."""
