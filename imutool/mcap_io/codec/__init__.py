"""MCAP records and message payloads to and from bytes."""
