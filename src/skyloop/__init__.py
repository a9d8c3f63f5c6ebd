"""Skyloop."""
