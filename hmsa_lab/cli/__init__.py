"""Commands for work at a bench."""
