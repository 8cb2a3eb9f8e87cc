"""Pure: process image, handshake, soft PLC; time enters as an argument."""
