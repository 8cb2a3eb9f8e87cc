"""Between the PLC and the cell: process image, handshake, journal."""
