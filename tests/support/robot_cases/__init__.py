"""Blind cases of robots: arms in MuJoCo, vehicles on wheels and in flight."""
