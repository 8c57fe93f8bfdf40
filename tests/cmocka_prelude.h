/* cmocka_prelude.h: what cmocka.h needs before it, in its order. TEST_FILTER="*threads*" picks tests by name. */
#ifndef CMOCKA_PRELUDE_H
#define CMOCKA_PRELUDE_H

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>

#ifdef TEST_WITHOUT_CMOCKA
#include "cmocka_alone.h"
#else
#include <cmocka.h>

__attribute__((constructor)) static void filter_tests(void)
{
    if (getenv("TEST_FILTER"))
        cmocka_set_test_filter(getenv("TEST_FILTER"));
}
#endif

#endif
