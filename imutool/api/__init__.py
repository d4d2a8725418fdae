"""Public functions behind `import imutool`, for paths, URLs and arrays."""
