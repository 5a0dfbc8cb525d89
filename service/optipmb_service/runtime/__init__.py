"""Stream actors with their mailboxes, the scheduler that runs them, and what they need of the network and the store."""
