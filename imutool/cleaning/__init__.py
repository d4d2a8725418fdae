"""Cleaning of a log's IMU: `survey` finds the defects, a `Cleaner` removes them."""

from imutool.cleaning.cleaner import Cleaner, cleaned
from imutool.cleaning.finding import Finding
from imutool.cleaning.first_pass import Survey, UntrustedError, look, raw_batches, survey
from imutool.cleaning.rule import CleaningSettings

__all__ = ["Cleaner", "CleaningSettings", "Finding", "Survey", "UntrustedError", "cleaned", "look", "raw_batches", "survey"]
