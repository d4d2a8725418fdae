"""`python -m imutool.cli`."""

from imutool.cli import main

main()
