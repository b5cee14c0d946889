"""What is measured: plain functions that return numbers, and do not judge."""
