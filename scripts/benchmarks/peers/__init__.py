"""Adapters for the peers: arrays in, arrays out."""
