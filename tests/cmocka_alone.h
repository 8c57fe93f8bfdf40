/* cmocka_alone.h: what the tests of guide_nn.h use of cmocka, for machines that lack it: -DTEST_WITHOUT_CMOCKA. The
   first failed assertion ends the program. With -DTEST_ONLY='"a b"' only the tests of these names run. */
#ifndef TEST_CMOCKA_ALONE_H
#define TEST_CMOCKA_ALONE_H

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define fail_msg(...) (printf("%s:%d: ", __FILE__, __LINE__), printf(__VA_ARGS__), printf("\n"), exit(1))
#define assert_true(x) ((x) ? (void)0 : (void)fail_msg("%s", #x))
#define assert_false(x) assert_true(!(x))
#define assert_null(p) assert_true(!(p))
#define assert_non_null(p) assert_true(p)
#define assert_int_equal(a, b) assert_true((a) == (b))
#define assert_memory_equal(a, b, size) assert_true(memcmp(a, b, size) == 0)
#define assert_string_equal(a, b) assert_true(strcmp(a, b) == 0)

struct CMUnitTest {
    const char *name;
    void (*run)(void **state);
};
#define cmocka_unit_test(f)                                                                                            \
    {                                                                                                                  \
#f, f                                                                                                          \
    }
#define cmocka_run_group_tests(tests, before, after) alone_run(tests, sizeof(tests) / sizeof *(tests))

#ifndef TEST_ONLY
#define TEST_ONLY ""
#endif

/* Is name a word of TEST_ONLY, or is that empty? */
static inline int alone_wanted(const char *name)
{
    const char *only = TEST_ONLY;
    size_t length = strlen(name);
    for (const char *at = strstr(only, name); at; at = strstr(at + 1, name))
        if ((at == only || at[-1] == ' ') && (!at[length] || at[length] == ' '))
            return 1;
    return !*only;
}

static inline int alone_run(const struct CMUnitTest *tests, size_t count)
{
    size_t ran = 0;
    for (size_t i = 0; i < count; ++i)
        if (alone_wanted(tests[i].name)) {
            tests[i].run(NULL);
            printf("ok %zu - %s\n", ++ran, tests[i].name);
        }
    return ran == 0;
}

#endif
