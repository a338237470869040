"""Recording messages to a bag, and playing them."""
