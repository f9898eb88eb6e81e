"""What commands compute, write and read: frozen records without behaviour of their own."""
