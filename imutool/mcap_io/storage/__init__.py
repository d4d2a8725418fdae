"""Byte sources and targets: files and object stores."""
