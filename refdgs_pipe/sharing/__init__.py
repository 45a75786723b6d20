"""Results that several machines share, in object storage or a shared folder. docs/batch.md."""
