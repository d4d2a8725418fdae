"""The diagnosis of one scalar signal."""
