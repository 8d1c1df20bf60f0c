"""Seeded fuzzing of all file readers: ``python -m tests.fuzz``."""
