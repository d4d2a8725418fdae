"""Effects of signals that are no IMU: joints, wheels, magnetometers, barometers, GNSS, ranges; one noun a file.

Each file has `effects(scale)`, which yields its effects for the sizes of the signal at hand. `DOMAINS` says which files serve
which kind of signal.
"""
