/* cmocka_prelude.h: what cmocka.h needs before it, in its order. */
#ifndef CMOCKA_PRELUDE_H
#define CMOCKA_PRELUDE_H

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#ifdef TEST_WITHOUT_CMOCKA
#include "cmocka_alone.h"
#else
#include <cmocka.h>
#endif

#endif
