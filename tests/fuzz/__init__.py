"""Fuzzing of all file readers."""
