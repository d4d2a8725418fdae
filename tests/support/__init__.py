"""What several test rooms share: made-up recordings, planted errors, viewers, an object store."""
