"""Effects of joints, wheels, magnetometers, barometers and GNSS; one noun a file.

Each file has `effects(scale)`, which yields its effects for the sizes of the signal at hand.
"""
