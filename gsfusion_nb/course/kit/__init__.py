"""For lecturers: a bank of quiz questions, tables of times, slides. Nothing here is shown to a learner."""
