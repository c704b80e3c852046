"""Results as plain values for JSON, every number with its unit; nothing is computed here."""
