{banner}

/* Steps computed by JAX: state and input before, state and output after. Points are random, at limits,
 * or on both sides of the threshold of a comparison. */

#ifndef {P}_VECTORS_H
#define {P}_VECTORS_H

#include <math.h>

#include "{p}.h"

typedef struct {{
    {p}_state before;
    {p}_input input;
    {p}_state after;
    {p}_output output;
    uint32_t status;
}} {p}_vector;

static const {p}_vector {p}_vectors[] = {{
{rows}
}};

#endif
