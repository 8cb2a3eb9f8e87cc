"""What judge keeps on disk: records, frames, object list."""
