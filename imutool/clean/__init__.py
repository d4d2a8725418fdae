"""What is wrong inside a log's IMU, and the log without it: `survey` looks, a `Cleaner` leaves out and converts."""

from imutool.clean.cleaner import Cleaner, cleaned
from imutool.clean.finding import Finding
from imutool.clean.first_pass import Survey, UntrustedError, look, raw_batches, survey
from imutool.clean.settings import Rules

__all__ = ["Cleaner", "Finding", "Rules", "Survey", "UntrustedError", "cleaned", "look", "raw_batches", "survey"]
