"""What holds files: artifacts kept between starts, pictures from disk."""
