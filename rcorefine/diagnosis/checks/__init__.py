"""The door before every other question: what is odd about a record, or about a model beside it."""
