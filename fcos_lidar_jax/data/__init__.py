"""Where points and boxes come from."""
