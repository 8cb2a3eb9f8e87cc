"""reconstruct: one frame to heights with an uncertainty for every point."""
