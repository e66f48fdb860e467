"""The facet.v1 schemas and what protoc made of them (`make proto`)."""
