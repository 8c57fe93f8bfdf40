/* counter.h: an allocator that counts and fails, for the tests of any header. */
#ifndef TEST_COUNTER_H
#define TEST_COUNTER_H

#include <stdbool.h>
#include <stdlib.h>

/* An allocator that counts, and fails from the fail_at-th request on (for one request, or all with fail_all). */
typedef struct counter {
    long live, requests, fail_at;
    size_t bytes, peak;
    bool fail_all;
} counter;

static inline void *count_allocate(void *user, size_t size)
{
    counter *c = user;
    c->requests++;
    if (c->fail_at && (c->requests == c->fail_at || (c->fail_all && c->requests > c->fail_at)))
        return NULL;
    size_t *p = malloc(size + 16);
    if (!p)
        return NULL;
    p[0] = size;
    c->live++;
    c->bytes += size;
    c->peak = c->bytes > c->peak ? c->bytes : c->peak;
    return (char *)p + 16;
}

static inline void count_release(void *user, void *pointer)
{
    counter *c = user;
    if (!pointer)
        return;
    size_t *p = (size_t *)(void *)((char *)pointer - 16);
    c->live--;
    c->bytes -= p[0];
    free(p);
}

/* Let a descriptor of any header allocate by c. */
#define count_with(desc, c) ((desc)->allocate = count_allocate, (desc)->release = count_release, (desc)->user = (c))

#endif
