"""Thousands of damaged and hostile inputs, by seed and number; each must end in one line and an exit code."""
