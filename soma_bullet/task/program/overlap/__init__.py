"""What may run at the same time, and how that is proven."""
