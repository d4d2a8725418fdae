"""MCAP: what the log holds, how an array becomes messages and back, and the pass-through that keeps every byte."""
