"""Damaged and hostile input, thousands of it, by seed and number: one line and an exit code go out."""
