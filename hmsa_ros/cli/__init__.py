"""Commands that run nodes and talk to them."""
