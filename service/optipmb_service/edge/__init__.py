"""What the edges share: who calls, what waits for a reader, and subscriptions that readers have in common."""
