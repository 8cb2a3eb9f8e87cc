"""What the screen says, as pure functions of the messages and a passed clock."""
