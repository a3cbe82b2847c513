"""Adapters to the peers: arrays in, arrays out."""
