"""The commands of ``hmsa`` for studies, and for the figures of the paper."""
