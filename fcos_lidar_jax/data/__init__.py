"""Readers of point clouds and boxes.

Files that are refused raise a ValueError of one line: the file, the place in it, the field, the found and the
expected value. Readers check the names of files at construction and their contents on reading a frame.
"""
