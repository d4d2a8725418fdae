"""Cleaning rules: one file each, named like the rule (`imutool.registry` finds them)."""
