"""Clouds of stops and of whole sites, as files."""
