"""What crosses Facet's wire and lands in its logs."""
