"""The outside things of the web interface: the web server."""
