"""What every Wearline service shares: messages, topics, recipe, artifacts, bus and runner."""
