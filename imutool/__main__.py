"""`python -m imutool`."""

from imutool.cli import main

main()
