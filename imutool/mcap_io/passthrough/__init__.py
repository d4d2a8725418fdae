"""Copy a log byte for byte: chunks checked on their way, and topics added between them."""
