"""Messages of several topics as they arrive: what is predicted from them, and how it is scored."""
