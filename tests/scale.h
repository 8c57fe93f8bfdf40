/* scale.h: how much of a statistical test's work is done. */
#ifndef TEST_SCALE_H
#define TEST_SCALE_H

/* Many samples find wrong formulas. Sanitizers, under which each takes several times as long, look for something else:
   an eighth of the samples is enough for them. What a test allows must follow from the number that is left. */
#if defined(__has_feature)
#if __has_feature(address_sanitizer) || __has_feature(thread_sanitizer)
#define TEST_SANITIZED
#endif
#endif
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
#define TEST_SANITIZED
#endif
#ifdef TEST_SANITIZED
#define LESS(n) ((n) / 8)
#else
#define LESS(n) (n)
#endif

#endif
